"""Looking into files before a survey exists: what each is, holds and lacks; the first survey file."""
