"""The page that `experiments.report` writes: its numbers, its pictures, its HTML."""
