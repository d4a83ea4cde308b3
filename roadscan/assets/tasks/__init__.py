"""Assets: returns of each square become evidence, evidence of all squares objects, objects tables and files."""
