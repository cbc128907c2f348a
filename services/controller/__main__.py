"""`python -m services.controller`."""

from common.runtime.service import main
from services.controller.service import ControllerService
from services.controller.settings import ControllerSettings

if __name__ == "__main__":
    main(ControllerSettings, ControllerService)
