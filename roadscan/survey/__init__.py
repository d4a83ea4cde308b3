"""Operations on a whole survey: check it before a run, run it, show its state, repair it, query it."""
