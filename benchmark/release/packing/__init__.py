"""Make releases: shards, their index, the card; and check them before they are uploaded."""
