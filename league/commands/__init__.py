"""What people type: one module per command or family of commands, each imported when it is asked for."""
