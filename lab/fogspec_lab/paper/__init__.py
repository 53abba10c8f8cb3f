"""The paper, reproduced: its tables and figures beside what this repository computes from the same samples."""
