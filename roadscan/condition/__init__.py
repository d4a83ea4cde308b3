"""What an engineer asks of a surface: roughness, texture, shape. One index, one file."""
