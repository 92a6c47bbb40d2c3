"""The token layer: motion text as a template, a layout, and a table of integers, and back to the byte."""

from .text import NumberText as NumberText
from .text import format_numbers as format_numbers
from .text import parse_numbers as parse_numbers
