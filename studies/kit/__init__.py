"""The kit of all studies: a plan of measurements, a record with commit and machine, resume, tables, plots, a page."""
