"""How uploads, pictures and photographs come in and are looked at."""
