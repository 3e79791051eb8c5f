"""Reports of a run: tables, sheets and plots."""
