"""The thesis's tables and figures made again, one module a chapter's part."""
