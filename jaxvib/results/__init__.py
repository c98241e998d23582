"""What every result has: status and sentence, text and figure, plain and labelled data, files."""
