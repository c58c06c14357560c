"""What one update does: from a configuration to jitted functions; imports of it go to its modules."""
