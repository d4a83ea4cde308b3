"""Raw logs into tables: fingerprints, keys and rows of logs; whether their times meet."""
