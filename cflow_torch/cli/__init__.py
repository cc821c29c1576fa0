"""The `cflow` command, one module per sub-command."""
