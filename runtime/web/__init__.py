"""The page that reconstructs in the browser, and the folder of files that it consists of."""
