"""What runs underneath: processes, files, settings, progress bars, the machine."""
