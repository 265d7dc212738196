"""One study per notebook: its experiment and its plots."""
