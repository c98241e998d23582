"""Protocol of results: status and sentence, text and figure, plain and labelled data, files."""
