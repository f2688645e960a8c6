"""What the images show: lungs, airways, spine, the scanner's field of view, and the air around a collapsed lung."""
