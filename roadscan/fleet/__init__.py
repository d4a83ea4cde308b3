"""Many surveys: a catalogue of them, and questions to all of them at once."""
