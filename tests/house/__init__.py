"""The size and shape of the library, measured, with limits that only fall."""
