"""What all tests share."""

import os

for _name in ("LABSEQ_DATA", "LABSEQ_PLUGIN_PATH"):  # the user's own must not reach the tests
    os.environ.pop(_name, None)
