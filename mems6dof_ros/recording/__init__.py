"""Records: MCAP bags, message schemas, tables."""
