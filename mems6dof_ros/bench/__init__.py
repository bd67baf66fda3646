"""What the instrument's speed is, each figure measured beside its peer or its limit in the same run."""
