"""Reading foreign files into contract datasets."""
