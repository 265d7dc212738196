"""The only floor that draws: plots, tables, films, viewers, and where each came from."""
