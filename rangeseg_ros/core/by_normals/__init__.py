"""Method normals: labels are directions of normals, as in the thesis."""
