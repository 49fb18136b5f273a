"""What the commands print: tables, JSON, words with their source."""
