"""Runs a survey: stages, sessions, tasks on workers, keys, status and progress."""
