"""From a frame to localizations: camera, detection, image fits, three-dimensional positions."""
