"""The nodes as a laboratory treats them: run, counted, disturbed, killed, told nonsense, set far apart."""
