"""The commands of `league`: one module per command or family of commands, each imported when it is needed."""
