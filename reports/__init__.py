"""What is concluded: tables, charts, pages from the documented tables. Imports no other package of this project."""
