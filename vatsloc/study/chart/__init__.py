"""Speed against accuracy of the method's variants."""
