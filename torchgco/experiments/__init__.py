"""Studies, from configurations to tables: the top layer of the library.

The only room that knows Hydra. `app` is the command, `config` makes objects of words, `flying` runs shares of a study
and resumes them, `results` are its files, `statistics` its tables, `reports` what is made of finished ones, `dataset`
keeps whole solutions. It imports all rooms. Begin with `app.py`.
"""
