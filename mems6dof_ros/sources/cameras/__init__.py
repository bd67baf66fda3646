"""Live cameras: drivers, pixel formats, clocks, and the source that joins them."""
