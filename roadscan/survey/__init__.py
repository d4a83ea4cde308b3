"""What is done with a survey as a whole: checked before a run, run, looked after, repaired, asked."""
