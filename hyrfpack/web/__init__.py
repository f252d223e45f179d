"""The page that shows a scene in a browser, made into one file or served."""
