"""Pictures: panels of curves, figures of a run, frames and GIFs, one colour an arm."""
