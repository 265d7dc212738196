"""The paper, one file per box of its overview figure; none knows a file or another floor above."""
