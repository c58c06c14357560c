"""What is read and written: run directories, checkpoints, rows, loggers, and lines on a terminal."""
