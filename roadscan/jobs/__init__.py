"""One file a step: load → compute → store. Jobs hold no formula."""
