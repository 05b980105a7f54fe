"""The laboratory's verbs, one file each."""
