"""The rangeseg command: a module for each subcommand, whose function takes all its options."""
