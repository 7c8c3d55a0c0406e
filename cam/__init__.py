"""From a heightfield to milling programs, and the removal they cause. Knows no port and no HTTP."""
