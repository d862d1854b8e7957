"""The form by which a person says that an alarm has been seen."""

from __future__ import annotations

from flask_wtf import FlaskForm
from wtforms import HiddenField, StringField
from wtforms.validators import DataRequired, Length

from suspnet.ground.limits import Severity
from suspnet.maintenance.alarms import Alarm


class Seen(FlaskForm):  # type: ignore[misc]
    """Name and words of a person, and the alarm as the page showed it."""

    by = StringField("Your name", [DataRequired("Say who you are."), Length(max=80)])
    words = StringField("What is done about it", [Length(max=500)])
    parameter, cause, severity = HiddenField(), HiddenField(), HiddenField()

    def means(self, alarm: Alarm) -> bool:
        """Return whether an alarm is the one of this form, and no worse than it was shown."""
        same = (alarm.parameter, str(alarm.cause)) == (self.parameter.data, self.cause.data)
        names = {str(one): one for one in Severity}
        return same and alarm.severity <= names.get(self.severity.data or "", -1)
