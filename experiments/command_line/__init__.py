"""What all entry points share: flags, help, signals, the runtime, the commands of srl-jax."""
