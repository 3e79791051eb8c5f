"""The groups and blocks of single tables, where they are more than rows on the nine scenes."""
