"""Motion recurring pattern analysis (Wang et al. 2020), and the methods that its paper compares."""

from .codec import Mrpa as Mrpa
