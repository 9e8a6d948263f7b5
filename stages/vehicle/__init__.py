"""What turns a raw log into a field that can be believed."""
