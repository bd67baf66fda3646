"""The live page: what the instrument measures, watched and steered from a browser."""
