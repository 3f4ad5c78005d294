"""Scenes looked at in a browser while they are changed: `live` has the scene and its images, `page` the page."""
