"""The command ``semantic-mapper``: one file a verb, and what verbs share."""
