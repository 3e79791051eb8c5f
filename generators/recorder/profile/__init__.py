"""The rig profile: all facts of an array that USB does not report, in one TOML file."""
