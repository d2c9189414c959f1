"""The command line's commands, one module a subject; each parses, calls and formats."""
