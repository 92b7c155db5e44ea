"""The command line: parsing, progress and printing around the library."""
