"""report.html: one file that shows where the nodule is, how sure that is, and what the run did."""
