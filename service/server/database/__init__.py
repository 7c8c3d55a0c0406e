"""The tables and every change to them: jobs, claims, runs, events, tokens, pairing codes and the count of tries."""
