"""What comes out of a run: its files, and the opened run with its residuals.

Dense depth and clouds, scores, pictures, exports, the report and the viewer are the packages below.
"""
