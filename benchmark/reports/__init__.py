"""What people look at after a run: tables, sheets and plots."""
