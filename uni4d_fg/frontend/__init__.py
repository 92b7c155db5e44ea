"""What a video gives the back end: sequences with their cues, point tracks with their labels, synthetic scenes."""
