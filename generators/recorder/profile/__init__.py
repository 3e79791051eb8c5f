"""The rig profile: what cannot be asked over USB, in one TOML file."""
