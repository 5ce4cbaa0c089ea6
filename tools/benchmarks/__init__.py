"""What kiras-bench measures: a module a part.

Each has `measure(request)`, which returns figures that fit into JSON, and `table(figures)`, which
needs nothing else; some have `plot(figures, path)`, too.
"""
