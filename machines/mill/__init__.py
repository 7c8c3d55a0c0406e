"""One mill in the hands of its owner: link, runs, journal, and what others see of it."""
