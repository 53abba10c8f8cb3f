"""Files: where they are, how they are read, with every refusal located, and how they are written whole or not at all."""
