"""What a run has on the host: its loop, its seeds, their environments and evaluations, and how it ends."""
