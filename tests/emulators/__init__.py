"""Small servers and instruments that stand at the far end of a real wire in the tests."""
