"""What this machine grants a process. Nothing here imports a library."""
