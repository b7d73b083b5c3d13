"""The package of the matcher plain-template."""
