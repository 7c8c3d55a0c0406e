"""DNC drip feed: a control that is fed over a serial line and only sends 'go on' (DC1) and 'stop' (DC3)."""
