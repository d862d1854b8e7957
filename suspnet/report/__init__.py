"""What people read: texts, tables, figures and pages."""
