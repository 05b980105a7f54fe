"""Verbs over many sessions: one task a file, their results as tables, questions to the tables, and a report.

* ``sources`` finds the files: folders, globs, and ``objects`` of an object store;
* ``jobs`` is the table of verbs: each makes rows of an open session;
* ``worker`` is the program that does jobs, one file after the other; ``task`` keeps one for each thread, with
  bounds of time and memory;
* ``running`` gives the tasks to threads or, by ``scheduler``, to Dask, and the rows to ``results``, the folder of
  tables: ``columns`` has their columns, ``tables`` their schemas, ``parts`` the list of the parts that count;
* ``loading`` has DuckDB read them, ``query`` answers SQL over them, and ``report`` draws them.
"""
