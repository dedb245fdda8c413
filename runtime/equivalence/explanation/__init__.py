"""Why single spikes differ: roots, and the deviation behind each."""
