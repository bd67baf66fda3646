"""Where frames come from: one small protocol, sources chosen by name."""
