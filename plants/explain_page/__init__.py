"""`estune explain` in the browser: from recorded files to the verdict, on this machine alone.

A `Workbook` is what the page works on: a folder with the files given to it, the map of their
columns, the model and the results. `ExplainPage` serves it. The records are read by the code of
`estune records`, and the verdict is that of `estune explain`, in a process of its own.
"""
