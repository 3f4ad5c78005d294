"""Light gathered once at points of an object, and its transfer to where it leaves: rendering without noise of S."""
