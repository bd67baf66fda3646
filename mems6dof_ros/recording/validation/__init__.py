"""What a record survives, as figures of `mems6dof validate lab`."""
