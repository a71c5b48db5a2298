"""From marks in cameras to the motion that lays a part right: images, calibration from moves, the rigid error."""
