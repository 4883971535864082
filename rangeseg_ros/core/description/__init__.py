"""What a plane is to its users: equation, size, outline."""
