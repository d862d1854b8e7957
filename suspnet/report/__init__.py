"""Output for people: texts, tables, figures and pages."""
