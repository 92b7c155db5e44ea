"""What comes out: the reconstruction, its files and its pictures."""
