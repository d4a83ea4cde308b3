"""Key frames of videos: which frames stand for pictures, and the files that they are decoded into."""
