"""The command line: one file per subcommand. The only room that parses arguments, prints, exits and catches."""
