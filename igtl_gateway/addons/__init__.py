"""What stands on the core and may be deleted: one folder for each add-on, with all that belongs to it."""
