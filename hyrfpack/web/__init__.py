"""The web page that shows a scene in a browser, as a single file or served over HTTP."""
