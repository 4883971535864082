"""File formats and scanners of the segmentation comparison of Hoover et al."""
