"""How a folder of raw logs becomes a survey without a person: watched, complete, answered by a fleet's template."""
