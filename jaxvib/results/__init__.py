"""Common interface of results: status and message, summary and figure, plain and labelled data, files."""
