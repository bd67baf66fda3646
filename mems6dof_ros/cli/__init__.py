"""The command line, `mems6dof`."""
