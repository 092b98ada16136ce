"""From files to objects: settings validated, plugins chosen and constructed; no device is opened."""
