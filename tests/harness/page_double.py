"""Double of a Meshcat page."""


class PageDouble:
    """Page whose sliders keep their values and whose buttons count their clicks.

    Attributes:
        sliders: Values by name.
        clicks: Numbers of clicks by name of the button.
    """

    def __init__(self):
        self.sliders, self.clicks = {}, {}

    def AddSlider(self, name, low, high, step, value, lower, higher):
        self.sliders[name] = value

    def AddButton(self, name, key):
        self.clicks[name] = 0

    def SetSliderValue(self, name, value):
        self.sliders[name] = value

    def GetSliderValue(self, name):
        return self.sliders[name]

    def GetButtonClicks(self, name):
        return self.clicks[name]
