"""One sweep over scenes, methods and seeds, and the tables that are generated from its records.

`plan` says what is measured, `sweep` measures it and keeps a record of each cell, `blocks` makes text of the records,
and `pages` puts it between the markers of the pages.
"""
