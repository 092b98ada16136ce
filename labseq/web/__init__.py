"""Shows runs in a browser: a web server that reads the data folder, the queue and the calibrations."""
