"""Inspects files before a survey exists: what each contains and lacks; and writes the first survey file."""
