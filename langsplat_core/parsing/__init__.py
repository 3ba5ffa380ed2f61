"""Reading files that nobody vouches for: whatever is wrong with one is a single InputError or FormatError,
and no memory is taken on the word of a header."""
