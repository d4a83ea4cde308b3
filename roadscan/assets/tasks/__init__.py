"""Assets: returns of each square into evidence, evidence of all squares into objects, objects into tables and files."""
