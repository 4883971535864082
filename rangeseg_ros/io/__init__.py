"""Files: images, cameras, clouds, bags."""
