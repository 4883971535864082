"""Method planes: labels are planes."""
