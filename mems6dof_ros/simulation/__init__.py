"""The physical simulator: optics, microsystem, camera, and the truth beside every frame."""
