"""Many runs: what they are, which of them are left to do, who runs them, and how far they are."""
