"""The experiments of Alvarez 2021, repeated on any cases."""
